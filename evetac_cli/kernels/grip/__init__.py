"""Laws of the grip: slip and finger position in, a goal position out."""
