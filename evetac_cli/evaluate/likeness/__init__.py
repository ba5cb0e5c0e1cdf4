"""evaluate likeness: the public facts about the real sensor, and what recordings and results of ours say of each."""
