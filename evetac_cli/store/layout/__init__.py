"""The layout of evetac's files.

schema      contents of each kind of file; checks arrays and files
contents    validity of values, of files and of new ones: limits of the schema, and rules across datasets
provenance  recipe, recipe id and header: the identity of a result; reading a header
netcdf      dimensions by name, for xarray
"""
