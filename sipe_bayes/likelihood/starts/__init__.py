"""States along recorded logs: where windows start."""
