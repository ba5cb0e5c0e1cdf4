"""Commands for people, which no stage needs: info, validate, repair, export, doctor, view."""
