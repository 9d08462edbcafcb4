"""What a person runs: the command line, the job engine, charts and reports."""
