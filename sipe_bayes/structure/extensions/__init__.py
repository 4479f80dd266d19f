"""Extensions: rows of one table, and what rows need."""
