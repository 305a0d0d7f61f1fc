"""The verdict in words, on a page and as the next command."""
