"""Definitions of the messages of mavros_msgs that are read, for bags that carry none.

ROS 1 bags and MCAP files hold the definitions of their messages, which are then used; files of
`sqlite3` storage before ROS 2 Iron don't.
"""

DEFINITIONS = {
    "mavros_msgs/msg/State": """
std_msgs/Header header
bool connected
bool armed
bool guided
bool manual_input
string mode
uint8 system_status
""",
    "mavros_msgs/msg/RCOut": """
std_msgs/Header header
uint16[] channels
""",
    "mavros_msgs/msg/RCIn": """
std_msgs/Header header
uint8 rssi
uint16[] channels
""",
    "mavros_msgs/msg/OverrideRCIn": """
uint16[18] channels
""",
    "mavros_msgs/msg/ManualControl": """
std_msgs/Header header
float32 x
float32 y
float32 z
float32 r
uint16 buttons
""",
    "mavros_msgs/msg/ParamValue": """
int64 integer
float64 real
""",
    "mavros_msgs/msg/Param": """
std_msgs/Header header
string param_id
mavros_msgs/ParamValue value
""",
    "mavros_msgs/msg/ParamEvent": """
std_msgs/Header header
string param_id
rcl_interfaces/ParameterValue value
uint16 param_index
uint16 param_count
""",
    "mavros_msgs/msg/EstimatorStatus": """
std_msgs/Header header
bool attitude_status_flag
bool velocity_horiz_status_flag
bool velocity_vert_status_flag
bool pos_horiz_rel_status_flag
bool pos_horiz_abs_status_flag
bool pos_vert_abs_status_flag
bool pos_vert_agl_status_flag
bool const_pos_mode_status_flag
bool gps_glitch_status_flag
bool accel_error_status_flag
""",
}
"""Text of each definition by its type (mavros 1 and 2)."""
