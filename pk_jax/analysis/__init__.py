"""What follows from the Jacobians: local indices, and their integrals over the workspace."""
