"""evaluate tracking: tracked dots against where they began and where they truly were."""
