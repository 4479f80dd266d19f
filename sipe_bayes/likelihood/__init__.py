"""log p(trajectory | theta): windows of logs (multiple shooting), chains of states, their noise and their algebra."""
