"""The benchmark's tasks, a file for each family of robots."""
