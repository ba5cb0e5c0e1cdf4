"""Recordings.

read        the reading API for Python: recordings as slices, features as a data set
trial_writer  trials that can be simulated again, written once
segments    growing recordings: closed segments, joined at the end
recovery    recovery of the segments of an interrupted recording
streams     measurements in addition to the events
"""
