"""Examples of everything that an outside package can add to evetac, one small module each."""
