"""How far a posterior can be trusted: scores, identifiability, agreement between logs, figures and the report."""
