"""What a session is as values: layers, the document that orders them, masks, pictures as PNG bytes. Knows no file."""
