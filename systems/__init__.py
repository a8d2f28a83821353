"""Drake systems and the diagram they form."""
