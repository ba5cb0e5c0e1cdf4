"""The scanning DVXplorer Mini: all pixels are compared five times per millisecond, but most can be left out."""
