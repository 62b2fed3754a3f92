# The runtime of OpenMP that the kernels' loops call. PyTorch brings one, which is to be shared; on
# macOS and Windows a second one ends the process. There the compiler is told of PyTorch's own.
set(UNIVOXEL_OPENMP "" CACHE FILEPATH "The runtime, or its import library; empty: as CMake finds it")
if(UNIVOXEL_OPENMP)
    add_library(univoxel_openmp INTERFACE)
    target_compile_options(univoxel_openmp INTERFACE "SHELL:-Xclang -fopenmp")
    target_link_libraries(univoxel_openmp INTERFACE ${UNIVOXEL_OPENMP})
    add_library(OpenMP::OpenMP_CXX ALIAS univoxel_openmp)
else()
    find_package(OpenMP REQUIRED)
endif()

# The name that PyTorch's libomp.dylib gives itself is no place where it is
function(share_openmp target)
    if(APPLE AND UNIVOXEL_OPENMP)
        set_target_properties(${target} PROPERTIES
            BUILD_WITH_INSTALL_RPATH ON INSTALL_RPATH "@loader_path/../../../torch/lib")
        add_custom_command(TARGET ${target} POST_BUILD COMMAND install_name_tool
            -change /opt/llvm-openmp/lib/libomp.dylib @rpath/libomp.dylib $<TARGET_FILE:${target}>)
    endif()
endfunction()
