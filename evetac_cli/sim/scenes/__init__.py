"""What may happen to a gel: an object gripped, a face pressed, an edge rubbed, a speaker that vibrates."""
