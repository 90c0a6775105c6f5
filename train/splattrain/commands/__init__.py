"""The commands that this distribution adds: `splatpainter data` and `splatpainter train`."""
