"""Recordings.

read        the reading API for Python: recordings as slices, features as a data set
trial_writer  trials that can be simulated again, written once
segments    recordings that grow: closed segments, joined at the end
recovery    what can be made of the segments of a recording that broke off
streams     what was measured beside the events
"""
