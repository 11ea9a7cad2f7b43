"""What networks trained on smooth surfaces and on tissue are worth elsewhere. See `__main__`."""
