"""Planning: hosting capacity over all hours."""
