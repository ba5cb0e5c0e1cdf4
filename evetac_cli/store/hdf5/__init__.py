"""HDF5 and the disk.

checked_hdf5  HDF5 files, evetac's and others, opened for reading
chunks        rows of datasets, chunk by chunk
disk          atomic writing of new files, also if the disk is full
"""
