"""``replay --batch FILE``: many recordings, on all cores or on a Dask cluster. What is done already
is not done again.

The file is YAML: a list of bags, or a mapping with the list under ``bags`` and, beside it, what
holds for all of them::

    vehicle: truck_07                      # recordings of one are compared with each other
    parent_topic: /lidar/odometry          # or parent_tf: odom:lidar; the same for child_...
    child_topic: /camera/odometry
    options: {method: dnlo, max_gap: 0.3}  # of the engine, by name
    bags:
      - monday/*                           # paths are relative to this file
      - s3://fleet/truck_07/*              # or URLs, with fsspec
      - bag: [tuesday/drive_0, tuesday/drive_1]
        name: tuesday                      # of its folder in --out; by default the bag's own
        child_topic: /camera/slam
        options: {reference: B10}

What is given for a bag goes before what holds for all, and that before the command line.
"""
