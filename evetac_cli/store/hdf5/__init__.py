"""HDF5 and the disk.

checked_hdf5  checked access to HDF5 files, evetac's and others
packed_bytes  checks that the bytes of a dataset are all in its file and unpack to the right size
hdf5_text   texts of an HDF5 file, read from its bytes
chunks      rows of datasets, chunk by chunk
disk        atomic writing of new files, also if the disk is full
"""
