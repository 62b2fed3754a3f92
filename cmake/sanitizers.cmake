add_library(univoxel_sanitizers INTERFACE)
if(UNIVOXEL_SANITIZE)
    target_compile_options(univoxel_sanitizers INTERFACE
        -fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -g
        -DUNIVOXEL_DEBUG=1)
    target_link_options(univoxel_sanitizers INTERFACE -fsanitize=address,undefined)
endif()
