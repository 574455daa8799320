"""Forward dynamics: from the active edges to one linear step of every body."""
