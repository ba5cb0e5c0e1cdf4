"""Stage files on disk: the only package that imports h5py.

schema      what a file of each kind holds; checks arrays and files
provenance  recipe, recipe id and header: the identity of a result
disk        new HDF5 files whose disk may be full
files       open, check, skip, write all-or-nothing
segments    recordings that grow: closed segments, joined at the end
read        the documented reading API: recordings as slices, features as a data set
imports     foreign event files -> our columns; import_* are its formats and the one door they all go through
exports     recordings -> files that other programs read; export_* are its formats
calibration dot grids as JSON
"""
