"""AX = XB solvers: motion pairs in, X = T_parent_child out."""
