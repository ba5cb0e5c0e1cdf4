"""Read and write the files of other programs.

imports.py reads them. It recognizes a format by the file's content, not by its name:

    AEDAT4          read/read_aedat4          states its frame size; needs the extra `convert` (lz4, zstandard)
    AEDAT 2         read/read_aedat2          of jAER and v2e: DVS128 and DAVIS, flipped so that top left is (0, 0)
    HDF5            read/read_hdf5            DSEC, rpg, MVSEC, M3ED, v2e, Prophesee: one row of its table each
    npy, npz        read/read_numpy           structured arrays, named columns, or tables (N, 4)
    Prophesee       read/prophesee            RAW (EVT2, EVT2.1, EVT3) and DAT, with external triggers
    ROS bags        read/bags/read_rosbag     of ROS 1 and ROS 2; needs the extra `convert` (rosbags, mcap)
    text, CSV       read/read_text            `t x y p` per line, or as the first line names them; integers are in us
    pickle          calibration_files         the official software's dot grid, for `calibrate`; holds no events

If a file does not describe its columns, one rule assumes their order and units (read/columns),
checks that the result is plausible, and reports the assumption. Contents other than events are counted and reported.
One rule unwraps clocks (read/clock), and one rule handles events out of order (read/time_order).

exports.py writes them:

    aedat4          write/event_files         what DV and dv-processing read; needs the extra `convert` (faery)
    dsec            write/event_files         HDF5 as in the DSEC data set: events/{x,y,t,p}, ms_to_idx, t_offset
    text            write/event_files         one line `t_us x y p` per event
    raw             write/event_files         Prophesee's RAW, EVT3
    mcap            write/write_mcap          ROS 2 messages, with dots, touch, gripper and control; `convert` (mcap)
    calibration     calibration_files         the dot grid: JSON, or the pickle that the official software reads
    parquet, csv    write/write_table         a trial, one row per slice; Parquet also many; extra `convert` (pyarrow)
    lerobot         write/lerobot             many trials as LeRobotDataset v3.0; extra `convert` (pyarrow, av)

Three modules are shared by several formats: the events of a recording in pieces (write/event_files), a trial as columns
(write/slice_columns), and a trial as frames (write/lerobot/episodes). The messages of mcap are defined in a separate
module (write/mcap_messages).
"""
