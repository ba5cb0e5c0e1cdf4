"""The ROBOTIS RH-P12-RN(A) gripper on a Dynamixel bus: registers, transactions and driver."""
