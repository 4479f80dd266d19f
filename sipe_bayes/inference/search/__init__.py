"""Methods that search where simulations are like the logs: simopt, adr, cem and bayesopt."""
