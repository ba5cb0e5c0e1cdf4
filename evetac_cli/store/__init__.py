"""evetac's files on disk; the only package that imports h5py for them.

hdf5        checked access to HDF5 files, evetac's and others, and atomic writing of new files
layout      contents of each kind of file, validity of values, and identity
recordings  reading recordings, writing growing ones, and recovering interrupted ones
files       open, check, skip and write files of all kinds
calibration dot grids as JSON
index       properties of all files of a data set, in one JSON file
"""
