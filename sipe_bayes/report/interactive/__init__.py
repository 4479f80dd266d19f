"""Signals of a report that a reader zooms, hovers over and picks from, drawn in the browser by uPlot."""
