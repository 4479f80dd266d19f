"""The command ``sipe``, one file per command group."""
