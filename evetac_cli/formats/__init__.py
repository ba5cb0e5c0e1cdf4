"""Files of other programs, read and written.

imports.py reads them; the content decides, not the file's name:

    AEDAT4          read/aedat/read_aedat4    says its frame size; needs the extra `convert` (lz4, zstandard)
    AEDAT 3.1       read/aedat/read_aedat3    of cAER; (0, 0) at the top left
    AEDAT 2         read/aedat/read_aedat2    of jAER and v2e: DVS128 and DAVIS, turned so that top left is (0, 0)
    HDF5            read/read_hdf5            DSEC, rpg, MVSEC, M3ED, v2e, Prophesee: a row of its table each
    npy, npz        read/read_numpy           structured arrays, named columns, or tables (N, 4)
    Prophesee       read/prophesee            RAW (EVT2, EVT2.1, EVT3) and DAT, with external triggers
    ROS bags        read/bags/read_rosbag     of ROS 1 and ROS 2; needs the extra `convert` (rosbags, mcap)
    text, CSV       read/read_text            `t x y p` a line or as the first line names them; integers are in us
    pickle          read/calibration_pickle   the official software's dot grid, for `calibrate`; holds no events

What a file leaves unsaid of its columns is assumed by one rule (read/column_order, read/column_times), tested for sense
and said; what it holds beside events is counted and said. A clock that wraps is followed by one rule (read/clock), and
events out of order are judged by one (read/time_order).

exports.py writes them:

    aedat4          write/write_aedat4        what DV and dv-processing read; needs the extra `convert` (faery)
    dsec            write/write_dsec          HDF5 as in the DSEC data set: events/{x,y,t,p}, ms_to_idx, t_offset
    text            write/write_text          a line `t_us x y p` for every event
    raw, raw-evt2   write/write_prophesee     Prophesee's RAW, EVT3 or EVT2
    dat             write/write_prophesee     Prophesee's DAT
    mcap            write/write_mcap          ROS 2 messages, with dots, touch, gripper and control; `convert` (mcap)
    calibration     write/write_calibration   the dot grid: JSON, or the pickle that the official software reads
    parquet, csv    write/write_table         a trial, a row a slice; Parquet of many trials; extra `convert` (pyarrow)
    touch-map       write/touch_map_table     touch maps, a row a cell: Parquet; extra `convert` (pyarrow)
    lerobot         write/lerobot             many trials as LeRobotDataset v3.0; extra `convert` (pyarrow, av)

One format is one module, however short, so that a reader finds it here by its name. What several share: the events of
a recording piece by piece (write/pieces), a trial as columns (write/slice_columns) and as frames
(write/lerobot/episodes). The messages of mcap are a module of their own (write/mcap_messages).
"""
