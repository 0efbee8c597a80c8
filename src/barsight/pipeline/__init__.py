"""Run the whole measurement: a recording in, a measured yard out.

recording -> rectified pair -> disparity -> points --+
crane or matched features -> trajectory -------------+-> map -> height surface -> contours -> agreement
                                                              +-> bundles -> their flanks, bars -> lifts
"""
