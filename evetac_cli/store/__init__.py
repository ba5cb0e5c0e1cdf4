"""Our own files on disk: the only package that imports h5py for them.

hdf5        the one door to HDF5 files, ours and other people's, and new files, all or nothing
layout      what a file of each kind holds, whether its values make sense, and its identity
recordings  recordings as they are read, as they grow, and what is made of one that broke off
files       open, check, skip and write files of all kinds
calibration dot grids as JSON
index       what each file of a data set is, in one SQLite file
"""
