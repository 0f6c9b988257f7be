"""What the edge service and the simulator must agree on, and nothing else."""
