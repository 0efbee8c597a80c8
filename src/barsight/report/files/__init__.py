"""The files of a result folder, written from a measurement: tables, rasters, cloud, result.json."""
