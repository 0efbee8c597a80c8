"""Write the files of a result folder from a measurement: tables, rasters, cloud, result.json."""
