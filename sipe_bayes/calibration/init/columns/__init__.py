"""What the columns of a log are: by their names, their numbers, and each other."""
