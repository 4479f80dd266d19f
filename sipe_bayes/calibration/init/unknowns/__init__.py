"""What may be unknown of a model, between which bounds, and what of it the logs tell."""
