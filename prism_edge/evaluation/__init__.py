"""Running a recording through the daemon and scoring what a subscriber got."""
