"""The benchmark: cells, their records, what runs them and what reads them."""
