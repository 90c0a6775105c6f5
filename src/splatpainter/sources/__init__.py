"""Services and programs that make pictures: by name, by entry point, by folder."""
