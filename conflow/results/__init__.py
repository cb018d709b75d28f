"""From finished runs to tables and claims."""
