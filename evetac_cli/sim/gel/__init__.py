"""The gel's surface in shear, its friction, and the contact with a gripped object."""
