"""What is kept of the labelled videos, and how it is stored and read."""
