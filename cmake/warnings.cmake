add_library(univoxel_warnings INTERFACE)
target_compile_options(univoxel_warnings INTERFACE -Wall -Wextra -Wno-unknown-pragmas)
