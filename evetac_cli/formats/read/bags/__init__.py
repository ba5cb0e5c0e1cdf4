"""ROS 1 and ROS 2 bags: events, other streams, and the messages that both are decoded from."""
