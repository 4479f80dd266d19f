"""A first configuration from a model and its logs: names, units, signs, delays and parameters, with evidence."""
