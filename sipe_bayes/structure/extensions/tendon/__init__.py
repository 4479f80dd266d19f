"""Extensions at a tendon."""
