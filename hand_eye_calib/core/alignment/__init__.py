"""Clock offset and scale of the child's stream, found before a method can solve."""
