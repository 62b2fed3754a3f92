add_library(univoxel_sanitizers INTERFACE)
set(SANITIZER_FLAGS_address -fsanitize=address,undefined -fno-sanitize-recover=undefined)
set(SANITIZER_FLAGS_thread -fsanitize=thread)
if(UNIVOXEL_SANITIZE)
    set(flags ${SANITIZER_FLAGS_${UNIVOXEL_SANITIZE}})
    if(NOT flags)
        message(FATAL_ERROR
            "UNIVOXEL_SANITIZE: expected address or thread, got ${UNIVOXEL_SANITIZE}")
    endif()
    target_compile_options(univoxel_sanitizers INTERFACE
        ${flags} -fno-omit-frame-pointer -g -DUNIVOXEL_DEBUG=1)
    target_link_options(univoxel_sanitizers INTERFACE ${flags})
    if(UNIVOXEL_SANITIZE STREQUAL "thread")  # it cannot see how libgomp's threads wait for another
        target_compile_options(univoxel_sanitizers INTERFACE -DUNIVOXEL_STD_THREADS=1)
    endif()
endif()
