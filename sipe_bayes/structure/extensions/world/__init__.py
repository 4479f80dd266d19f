"""Extensions of sensors, of the world and of what no piece of physics explains."""
