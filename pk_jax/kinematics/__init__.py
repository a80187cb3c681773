"""Jacobians, the Newton solver, inverse and forward kinematics, and the laws that check them."""
