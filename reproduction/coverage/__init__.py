"""Coverage study: errors against the Cramer-Rao bound, and coverage of the stated intervals."""
