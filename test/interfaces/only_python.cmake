# The tests use these messages from Python and over DDS: without C++ they build in two thirds of the time.
# Which generators run is a list that find_package fills; dependencies' own packages insist on finding all of them.
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "cpp")
