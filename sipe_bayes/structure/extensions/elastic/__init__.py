"""Extensions of gears, links and bases that give way."""
