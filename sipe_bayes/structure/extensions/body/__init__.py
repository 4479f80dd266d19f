"""Extensions at a body: its numbers that the model has wrong."""
