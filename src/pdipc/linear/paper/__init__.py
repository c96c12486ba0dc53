"""Section 5: A-Jacobi and its relatives."""
