"""The project file: an SQLite database that holds the original, layers, history and results; files out of it."""
