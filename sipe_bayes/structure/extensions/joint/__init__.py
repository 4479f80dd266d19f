"""Extensions at joints."""
