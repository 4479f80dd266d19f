"""What a model lacks: seen in the residuals, named, and allowed for in the intervals."""
