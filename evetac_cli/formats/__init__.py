"""Files of other programs, read and written.

imports.py reads them; the content decides, not the file's name:

    AEDAT4          read/read_aedat4      says its frame size; needs the extra `convert` (faery)
    HDF5 as DSEC    read/read_dsec        events/{t,x,y,p} in microseconds, t_offset
    Prophesee       read/read_prophesee   RAW (EVT2, EVT3) and DAT; needs the extra `convert` (faery)
    ROS bags        read/read_rosbag      of ROS 1 and ROS 2; needs the extra `convert` (rosbags)
    text            read/read_text        `t x y p` a line, blanks or commas, `#` comments; integers are microseconds
    pickle          read/calibration_pickle   the official software's dot grid, for `calibrate`; holds no events

exports.py writes them:

    aedat4          write/write_aedat4        what DV and dv-processing read; needs the extra `convert` (faery)
    dsec            write/write_dsec          HDF5 as in the DSEC data set: events/{x,y,t,p}, ms_to_idx, t_offset
    text            write/write_text          a line `t_us x y p` for every event
    raw, raw-evt2   write/write_prophesee     Prophesee's RAW, EVT3 or EVT2
    dat             write/write_prophesee     Prophesee's DAT
    mcap            write/write_mcap          ROS 2 messages, with dots, forces, gripper and control; `convert` (mcap)
    calibration     write/write_calibration   the dot grid: JSON, or the pickle that the official software reads
    parquet, csv    write/write_table         a trial, a row a slice; Parquet of many trials; extra `convert` (pyarrow)
    lerobot         write/write_lerobot       many trials as LeRobotDataset v3.0; extra `convert` (pyarrow, av)

One format is one module, however short, so that a reader finds it here by its name. What several share: the events of
a recording piece by piece (write/pieces), a trial as columns (write/slice_columns) and as frames (write/episodes).
"""
