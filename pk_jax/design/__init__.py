"""Design variables, the composite index, and its maximization by gradients."""
