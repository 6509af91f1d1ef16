"""The table of pharmacometrics: its columns and checks, its doses, and the panel made of them."""
