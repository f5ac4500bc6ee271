"""Draw figures and reports; no other package but `fleet` imports Matplotlib."""
