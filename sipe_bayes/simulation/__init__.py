"""How it is simulated: engines, closed loop, any function as a simulator, the Gymnasium faces."""
