"""Pictures, folders and videos: reading, describing, tracking, comparing with a reference surface, exporting."""
