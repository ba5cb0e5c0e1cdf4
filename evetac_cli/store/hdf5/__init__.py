"""HDF5 and the disk.

checked_hdf5  the one door to HDF5 files, ours and other people's: what is read was checked there first
packed_bytes  whether the bytes of a dataset are all in its file, and unpack to no more than they have to
hdf5_text   texts of an HDF5 file, read from its bytes
chunks      rows of datasets, chunk by chunk
disk        new files, all or nothing, also where the disk is full
"""
