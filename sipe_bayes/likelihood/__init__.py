"""log p(trajectory | theta): windows and chains of states, their noise, and the algebra that integrates starts out."""
