"""What an agent earns in the target after training where an estimator believes the target to be."""
