"""What commands share: options and their parsing, what the terminal shows, files edited by operations."""
