"""A night: runs a profile's experiments and canaries, keeps the history, asks the gate, writes the page."""
