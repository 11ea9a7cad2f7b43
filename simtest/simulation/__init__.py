"""A labelled frame: a rendering session, the camera chain, true highlights and viewpoints."""
