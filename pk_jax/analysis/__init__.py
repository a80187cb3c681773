"""What follows from the Jacobians: indices and their integrals, singularities, limits and proofs, noise."""
