"""Models of others: read, tried and compiled so that whatever they do is one line."""
