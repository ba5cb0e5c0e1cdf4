"""Touch maps: contact patch, shear, pressure and forces, estimated from the motion of a gel's dots."""
