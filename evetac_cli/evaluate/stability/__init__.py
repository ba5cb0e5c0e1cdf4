"""evaluate stability: stiff and extreme cases, part by part."""
