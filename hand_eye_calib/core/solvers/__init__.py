"""Solvers of AX = XB, which estimate X = T_parent_child from motion pairs (A, B)."""
