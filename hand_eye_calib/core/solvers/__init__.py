"""Solvers of AX = XB: motion pairs in, X = T_parent_child out."""
