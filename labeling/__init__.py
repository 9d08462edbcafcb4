"""Video in, pseudo-labels and control videos out. Imports no other package of the project, and never torch."""
