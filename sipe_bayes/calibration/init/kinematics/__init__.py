"""What kinematics alone tell of columns, without simulations."""
