"""What everything stands on: files, resources, seeds, provenance, measuring, and engines that do the work."""
