# One build of the extension per instruction set: univoxel/_core/<variant>/_core.*.so. At import the
# Python side picks the one that torch reports for this processor, so one wheel is fast everywhere
# and the kernels hold no dispatch code. The bindings know nothing of vectors: compiled once.
set(UNIVOXEL_VARIANTS default)
if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64" AND NOT UNIVOXEL_SANITIZE)
    list(APPEND UNIVOXEL_VARIANTS avx2 avx512)
endif()
set(UNIVOXEL_FLAGS_default "")
set(UNIVOXEL_FLAGS_avx2 -march=x86-64-v3)
set(UNIVOXEL_FLAGS_avx512 -march=x86-64-v4 -mprefer-vector-width=512)

function(add_core_variants)
    cmake_parse_arguments(ARG "" "" "BINDINGS;KERNELS" ${ARGN})
    # The compiler takes gathers to be slow unless told of a processor where they are not.
    if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
        set_source_files_properties(csrc/integrator.cpp csrc/stereo.cpp PROPERTIES
            COMPILE_OPTIONS -mtune=icelake-server)
    endif()
    add_library(univoxel_bindings OBJECT ${ARG_BINDINGS})
    target_include_directories(univoxel_bindings PRIVATE csrc)
    target_link_libraries(univoxel_bindings PRIVATE
        pybind11::module univoxel_embree univoxel_warnings univoxel_sanitizers xatlas glm::glm)
    # Each file alone makes most of pybind11 anew: together they compile in a third of the time.
    set_target_properties(univoxel_bindings PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 6)
    set(optimisation -O3)
    if(UNIVOXEL_SANITIZE)  # instrumented code takes minutes to optimise
        set(optimisation -O1)
        target_compile_options(univoxel_bindings PRIVATE -O0)
        set(extras NO_EXTRAS)  # not stripped: reports name functions and lines
    endif()
    foreach(variant IN LISTS UNIVOXEL_VARIANTS)
        add_library(kernels_${variant} STATIC ${ARG_KERNELS})
        target_include_directories(kernels_${variant} PUBLIC csrc)
        target_link_libraries(kernels_${variant} PUBLIC
            OpenMP::OpenMP_CXX glm::glm univoxel_embree univoxel_warnings univoxel_sanitizers)
        # No -ffast-math: at link time it would flush denormals in the whole process, torch included.
        target_compile_options(kernels_${variant} PRIVATE
            ${optimisation} -fno-math-errno -fno-trapping-math ${UNIVOXEL_FLAGS_${variant}})
        pybind11_add_module(core_${variant} ${extras} $<TARGET_OBJECTS:univoxel_bindings>)
        set_target_properties(core_${variant} PROPERTIES
            OUTPUT_NAME _core
            LIBRARY_OUTPUT_DIRECTORY ${CMAKE_CURRENT_BINARY_DIR}/_core/${variant})
        target_link_libraries(core_${variant} PRIVATE kernels_${variant} xatlas)
        share_openmp(core_${variant})
        install(TARGETS core_${variant} LIBRARY DESTINATION univoxel/_core/${variant})
    endforeach()
endfunction()
