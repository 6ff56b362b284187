// Has one Vulkan driver compile the kernels and prints what VK_KHR_pipeline_executable_properties says of each:
//
//   pipelines FOLDER < kernels.txt
//
// A line in: name, SPIR-V file in FOLDER, nine specialisation constants. A line out: name, tab, cell of the table. The pipeline
// layout is the project's (vulkan/src/pipelines.rs): a uniform buffer at binding 0, storage buffers at 1 to 8, uniform texel
// buffers at 9 to 13, or storage buffers there, too, for files named .storage.spv; 16 bytes of push constants. No work is
// submitted, so a driver over a fake kernel device (Mesa's drm-shim) serves as well as a board.
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#define VK_NO_PROTOTYPES
#include <vulkan/vulkan_core.h>

static PFN_vkGetInstanceProcAddr get;
static VkInstance instance;
static VkDevice device;
#define LOAD(name) PFN_##name name = (PFN_##name)get(instance, #name)

static void check(const char *what, int result) {
    if (!result) return;
    fprintf(stderr, "%s: VkResult %d\n", what, result);
    exit(3);
}

static VkPipelineLayout layout_reading(VkDescriptorType read) {
    LOAD(vkCreateDescriptorSetLayout);
    LOAD(vkCreatePipelineLayout);
    VkDescriptorSetLayoutBinding bindings[14];
    for (uint32_t i = 0; i < 14; i++)
        bindings[i] = (VkDescriptorSetLayoutBinding){
            .binding = i, .descriptorCount = 1, .stageFlags = VK_SHADER_STAGE_COMPUTE_BIT,
            .descriptorType = i == 0 ? VK_DESCRIPTOR_TYPE_UNIFORM_BUFFER : i < 9 ? VK_DESCRIPTOR_TYPE_STORAGE_BUFFER : read};
    VkDescriptorSetLayoutCreateInfo sets = {.sType = VK_STRUCTURE_TYPE_DESCRIPTOR_SET_LAYOUT_CREATE_INFO,
                                            .bindingCount = 14, .pBindings = bindings};
    VkDescriptorSetLayout set;
    check("vkCreateDescriptorSetLayout", vkCreateDescriptorSetLayout(device, &sets, NULL, &set));
    VkPushConstantRange push = {.stageFlags = VK_SHADER_STAGE_COMPUTE_BIT, .size = 16};
    VkPipelineLayoutCreateInfo info = {.sType = VK_STRUCTURE_TYPE_PIPELINE_LAYOUT_CREATE_INFO, .setLayoutCount = 1,
                                       .pSetLayouts = &set, .pushConstantRangeCount = 1, .pPushConstantRanges = &push};
    VkPipelineLayout layout;
    check("vkCreatePipelineLayout", vkCreatePipelineLayout(device, &info, NULL, &layout));
    return layout;
}

static VkPipelineExecutableStatisticKHR statistics[64];
static uint32_t count;

static unsigned long long value(const char *name) {
    for (uint32_t i = 0; i < count; i++)
        if (!strcasecmp(statistics[i].name, name))
            return statistics[i].format == VK_PIPELINE_EXECUTABLE_STATISTIC_FORMAT_FLOAT64_KHR
                       ? (unsigned long long)statistics[i].value.f64
                       : (unsigned long long)statistics[i].value.u64;
    return 0;
}

static int said(const char *name) {
    for (uint32_t i = 0; i < count; i++)
        if (!strcasecmp(statistics[i].name, name)) return 1;
    return 0;
}

static void cell(VkPipeline pipeline) {
    LOAD(vkGetPipelineExecutableStatisticsKHR);
    VkPipelineExecutableInfoKHR info = {.sType = VK_STRUCTURE_TYPE_PIPELINE_EXECUTABLE_INFO_KHR, .pipeline = pipeline};
    count = 64;
    for (int i = 0; i < 64; i++)
        statistics[i] = (VkPipelineExecutableStatisticKHR){.sType = VK_STRUCTURE_TYPE_PIPELINE_EXECUTABLE_STATISTIC_KHR};
    vkGetPipelineExecutableStatisticsKHR(device, &info, &count, statistics);
    if (said("TMU Spills")) {  // V3D; its memory holds 16 lanes' spilled registers and arrays
        printf("%llu t%llu %llu/%llu", value("Instruction Count"), value("Thread Count"), value("TMU Spills"),
               value("TMU Fills"));
        if (value("Spill Size")) printf(" %llu B", value("Spill Size") / 16);
        printf("\n");
    } else if (said("Spills"))  // Mali
        printf("%llu t%llu %llu/%llu\n", value("Instructions"), value("Threads"), value("Spills"), value("Fills"));
    else if (said("Max Waves Per Core"))  // Adreno: private memory
        printf("%llu w%llu %llu/%llu\n", value("Instruction Count"), value("Max Waves Per Core"), value("STP Count"),
               value("LDP Count"));
    else
        printf("compiles\n");
}

int main(int argc, char **argv) {
    if (argc != 2) return fprintf(stderr, "usage: pipelines FOLDER < kernels.txt\n"), 2;
    setvbuf(stdout, NULL, _IOLBF, 0);
    void *loader = dlopen("libvulkan.so.1", RTLD_NOW);
    if (!loader) return fprintf(stderr, "%s\n", dlerror()), 3;
    get = (PFN_vkGetInstanceProcAddr)dlsym(loader, "vkGetInstanceProcAddr");
    LOAD(vkCreateInstance);
    VkApplicationInfo app = {.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO, .apiVersion = VK_API_VERSION_1_1};
    VkInstanceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO, .pApplicationInfo = &app};
    check("vkCreateInstance", vkCreateInstance(&info, NULL, &instance));
    LOAD(vkEnumeratePhysicalDevices);
    LOAD(vkGetPhysicalDeviceProperties);
    LOAD(vkCreateDevice);
    VkPhysicalDevice physical[8];
    uint32_t n = 8;
    check("vkEnumeratePhysicalDevices", vkEnumeratePhysicalDevices(instance, &n, physical));
    check("no device", n == 0);
    VkPhysicalDeviceProperties properties;
    vkGetPhysicalDeviceProperties(physical[0], &properties);
    fprintf(stderr, "%s (vendor %04x)\n", properties.deviceName, properties.vendorID);
    float one = 1;
    VkDeviceQueueCreateInfo queue = {.sType = VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO, .queueCount = 1,
                                     .pQueuePriorities = &one};
    VkPhysicalDevicePipelineExecutablePropertiesFeaturesKHR feature = {
        .sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_PIPELINE_EXECUTABLE_PROPERTIES_FEATURES_KHR, .pipelineExecutableInfo = VK_TRUE};
    const char *name = VK_KHR_PIPELINE_EXECUTABLE_PROPERTIES_EXTENSION_NAME;
    VkDeviceCreateInfo create = {.sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO, .pNext = &feature, .queueCreateInfoCount = 1,
                                 .pQueueCreateInfos = &queue, .enabledExtensionCount = 1, .ppEnabledExtensionNames = &name};
    check("vkCreateDevice", vkCreateDevice(physical[0], &create, NULL, &device));
    const uint32_t buffers = properties.limits.maxPerStageDescriptorStorageBuffers;
    VkPipelineLayout texels = layout_reading(VK_DESCRIPTOR_TYPE_UNIFORM_TEXEL_BUFFER);
    VkPipelineLayout storage = buffers < 13 ? texels : layout_reading(VK_DESCRIPTOR_TYPE_STORAGE_BUFFER);
    LOAD(vkCreateShaderModule);
    LOAD(vkCreateComputePipelines);

    char label[128], file[128], path[512];
    uint32_t values[9];
    while (scanf("%127s %127s %u %u %u %u %u %u %u %u %u", label, file, values, values + 1, values + 2, values + 3, values + 4,
                 values + 5, values + 6, values + 7, values + 8) == 11) {
        static uint32_t code[1 << 18];
        snprintf(path, sizeof path, "%s/%s", argv[1], file);
        FILE *in = fopen(path, "rb");
        if (!in) return fprintf(stderr, "%s is not there\n", path), 3;
        const size_t words = fread(code, 4, 1 << 18, in);
        fclose(in);
        printf("%s\t", label);
        const int reads_storage = strstr(file, ".storage.") != NULL;
        if (reads_storage && buffers < 13) {
            printf("too few buffers\n");
            continue;
        }
        VkShaderModuleCreateInfo text = {.sType = VK_STRUCTURE_TYPE_SHADER_MODULE_CREATE_INFO, .codeSize = words * 4,
                                         .pCode = code};
        VkShaderModule module;
        VkSpecializationMapEntry entries[9];
        for (uint32_t i = 0; i < 9; i++) entries[i] = (VkSpecializationMapEntry){i, 4 * i, 4};
        VkSpecializationInfo special = {9, entries, sizeof values, values};
        VkPipeline pipeline;
        int failed = vkCreateShaderModule(device, &text, NULL, &module);
        VkComputePipelineCreateInfo wanted = {
            .sType = VK_STRUCTURE_TYPE_COMPUTE_PIPELINE_CREATE_INFO, .layout = reads_storage ? storage : texels,
            .flags = VK_PIPELINE_CREATE_CAPTURE_STATISTICS_BIT_KHR,
            .stage = {.sType = VK_STRUCTURE_TYPE_PIPELINE_SHADER_STAGE_CREATE_INFO, .stage = VK_SHADER_STAGE_COMPUTE_BIT,
                      .module = module, .pName = "main", .pSpecializationInfo = &special}};
        failed = failed ? failed : vkCreateComputePipelines(device, VK_NULL_HANDLE, 1, &wanted, NULL, &pipeline);
        if (failed)
            printf("fails\n");
        else
            cell(pipeline);
    }
    return 0;
}
