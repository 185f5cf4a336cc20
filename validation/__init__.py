"""How accurate the program is and how often its intervals hold, by simulation: ``python -m validation NAME``."""
