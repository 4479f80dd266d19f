"""Extensions at actuators."""
