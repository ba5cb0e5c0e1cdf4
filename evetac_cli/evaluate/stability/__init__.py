"""evaluate stability: stiff, extreme and senseless cases, part by part."""
