"""The page about a search over structures: figures, words, HTML."""
