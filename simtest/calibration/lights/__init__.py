"""Where the lights are, from their highlights on mirrors of known shape: a ball, or a flat plate.

mirrors says where a mirror shows a light, and back. bundle fits light positions to highlights, with the errors of the
mirrors. search finds how many lights there are and which highlight is whose. result states intervals and doubts.
docs/howto/cameras.md describes the measurement.
"""
