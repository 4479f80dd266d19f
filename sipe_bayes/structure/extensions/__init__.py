"""Extensions: one file each, by what they are placed at."""
