"""evaluate likeness: public facts about the real sensor, and what recordings and evetac's results show for each."""
