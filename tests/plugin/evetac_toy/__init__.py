"""What a package from outside can add to evetac, one small module each."""
