"""evaluate stability: stiff, extreme and invalid cases, part by part."""
