"""The scanning DVXplorer Mini: all pixels compared five times a millisecond, most of them left out."""
