"""What is fed to every reader and to the command line, and what must not happen: `make fuzz`."""
