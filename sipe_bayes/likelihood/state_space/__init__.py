"""States unknown at every sample: the chain of them, its linearisation, and the algebra that integrates them out."""
