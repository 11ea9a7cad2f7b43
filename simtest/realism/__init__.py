"""How far generated frames are from real ones: statistics of frames by one detector, and the distance of two sets."""
