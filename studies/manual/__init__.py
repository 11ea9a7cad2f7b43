"""The manual's generated pages, and checks of the manual: its links and its commands. See `__main__`."""
